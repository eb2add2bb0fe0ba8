"""A catalog on disk: journal, SQLite file and lock. Contract: rr_actors/registrar/model/store.py."""

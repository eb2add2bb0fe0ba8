"""A catalog on disk: journal, SQLite file and lock. Contract: store.py."""

"""A catalog on disk: journal, SQLite file, image and lock. Contract: store.py."""

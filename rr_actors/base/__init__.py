"""The base of all rooms: errors, names and configuration; and values as bytes, checked and canonical."""

__version__ = "0.1.0"

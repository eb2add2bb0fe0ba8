"""The base of all rooms: errors, names and configuration; and values as bytes, checked and canonical."""

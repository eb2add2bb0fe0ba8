"""The decisions of a registrar, as pure functions of its catalog: decide.py is the table of contents."""

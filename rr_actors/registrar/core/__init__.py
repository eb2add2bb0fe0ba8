"""What a registrar decides, as pure functions of its catalog: decide.py is the table of contents."""

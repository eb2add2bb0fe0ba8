"""Child processes: started from a fork server, watched, signalled, and ended with all that they started."""

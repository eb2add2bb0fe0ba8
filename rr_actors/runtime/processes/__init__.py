"""Child processes: started by a fork server, watched, signalled, and ended with all their descendants."""

"""What one process of a system has before any registrar is open in it: its loop, connections and files."""

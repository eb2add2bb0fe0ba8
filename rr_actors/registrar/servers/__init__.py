"""The servers of a registrar: they run their callbacks in workers, and say how these ended."""

"""What a process runs on: the event loop, worker threads, time limits, and how threads wake each other."""

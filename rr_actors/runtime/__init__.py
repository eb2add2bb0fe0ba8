"""The base of a process: the event loop, worker threads, time limits, and how threads wake each other."""

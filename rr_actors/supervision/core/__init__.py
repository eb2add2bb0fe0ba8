"""What a supervisor decides, as pure functions of its state: no I/O, clock, thread or randomness."""

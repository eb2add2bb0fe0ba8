"""The live terminal of `rr-actors top`: its link to the system, rows, the lines of events, and the application."""

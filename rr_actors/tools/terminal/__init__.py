"""The live terminal of `rr-actors top`: the way to the system, the rows of each pane, and the application."""

"""The live terminal of `rr-actors top`: its link to the system, the rows of each pane, and the application."""

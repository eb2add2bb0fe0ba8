"""The command `rr-actors`."""

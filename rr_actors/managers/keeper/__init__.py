"""Keeper: the manager that keeps what a file wants, and says of what is not there why it is not."""

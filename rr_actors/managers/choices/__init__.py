"""Choices: which of several servers gives what is asked for, now that some of them fail."""

"""Reporting: exceptions as text and as bytes, and the log. None of it can fail."""

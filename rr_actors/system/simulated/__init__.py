"""A tree of supervisors in virtual time: an hour of crashes in milliseconds, and what the settings change about it."""

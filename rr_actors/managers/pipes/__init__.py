"""Pipes: chains of components that end in what is asked for, and the segment that takes the place of a failed one."""

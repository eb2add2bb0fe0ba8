"""Supervisors: they start children, watch them, and restart them as the pure decisions in core say."""

"""Connections between registrars, and by which of them an answer goes back."""

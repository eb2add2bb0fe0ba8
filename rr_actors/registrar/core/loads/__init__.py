"""Loads at a provider: they join, begin, or wait in line; those that would wait for each other are found."""

"""Benchmarks of rr_actors: `make bench`, or `make bench-quick` for a smoke run."""

"""The same echo by rr_actors and by others, side by side: `make bench-peers`, or `python -m benchmarks.peers`."""

"""Experiments about supervision: crashes, restarts, and when a supervisor gives up."""

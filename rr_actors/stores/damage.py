"""Damage: what is stored is not what was written."""

from __future__ import annotations


class Damage(Exception):
    """Something read is not what a catalog has there. The text goes on from "expected a catalog, got"."""

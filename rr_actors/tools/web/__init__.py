"""The live web page of `rr-actors web`, and the lab: their access check, their watch of a system, and their pages."""

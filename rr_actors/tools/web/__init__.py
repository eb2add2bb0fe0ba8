"""The live web page of `rr-actors web`, and the lab: access to it, what it knows of a system, and its pages."""

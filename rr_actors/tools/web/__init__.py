"""The live web page of `rr-actors web`, and the lab: what it knows of a system, who may open it, and its pages."""

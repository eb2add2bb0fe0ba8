"""Pictures: what notebooks and files show of a system, drawn here: SVG, HTML tables, and both in one bundle."""

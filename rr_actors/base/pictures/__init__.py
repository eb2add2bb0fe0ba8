"""Pictures of a system for notebooks and files: SVG, HTML tables, and both in one bundle."""

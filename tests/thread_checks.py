"""Has the package check which thread calls what. pytest loads this before any plugin imports the package."""

import os

os.environ["RR_ACTORS_CHECK_THREADS"] = "1"

"""Exercises: small files to mend, each with a check that runs when the file is saved (`rr-actors learn`)."""

"""The lab: a page that asks what an experiment will show, runs it, plays it again, and says what was right."""

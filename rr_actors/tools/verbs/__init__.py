"""The verbs of the command `rr-actors`: each module is imported when one of its verbs is called."""

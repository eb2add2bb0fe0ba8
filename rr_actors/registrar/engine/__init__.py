"""What carries decisions out: decide, commit, act; and the servers whose callbacks run."""

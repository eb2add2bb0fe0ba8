"""How decisions are carried out: decide, commit, act; and the servers whose callbacks run."""

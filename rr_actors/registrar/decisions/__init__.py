"""What a registrar has decided: noted while a recording asks for it, and decided again from what was noted."""

"""Values as bytes: canonical, typed, and the types that travel."""

"""Actions: code that a graph of the Unified Meaning Representation Format (UMRF) runs, and the graphs."""

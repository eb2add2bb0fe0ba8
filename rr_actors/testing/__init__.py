"""What an application tests itself with: the plugin of pytest."""

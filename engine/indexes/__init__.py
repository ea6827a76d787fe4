"""What is prepared of a map for a method, once, and looked up by window."""

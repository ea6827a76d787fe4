"""Speed and memory beside the peers: NCC, SIFT, growth with size, maps too large for memory. ``make bench``."""

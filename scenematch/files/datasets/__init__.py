"""Readers of published data sets, one per layout, and the writer of their flight folders."""

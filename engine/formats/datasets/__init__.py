"""Published data sets: a reader a layout, from the files that a user has downloaded to a flight folder."""

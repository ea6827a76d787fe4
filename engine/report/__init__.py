"""What a finished track is worth: its figures of merit and its plots."""

"""What writes the measured pages and figures of docs."""

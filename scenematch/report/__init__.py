"""Reports on finished tracks: figures of merit, plots, pages and the live view."""

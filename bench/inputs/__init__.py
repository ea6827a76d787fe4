"""What the benchmarks draw from: scenes, pairs of pictures, and log files with known values."""

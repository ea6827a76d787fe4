"""The machine: devices, threads, real time, worker processes, compilation and the budget of a frame."""

"""In the loop: latency, soak, bridges beside a stand-in autopilot, and fuzz of all that comes from outside."""

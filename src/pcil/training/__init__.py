"""Training: what a run is, its loop, and what it leaves."""

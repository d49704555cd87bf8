"""Figures and tables from run folders and CSV files. Only `representation` and `film` import JAX."""

"""Pictures and tables from run folders and CSV files; nothing here imports JAX."""

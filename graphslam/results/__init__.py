"""What is written: the result folder, and the report pages with their figures."""

"""A plan's processes on one host: started, watched, spoken to, ended."""

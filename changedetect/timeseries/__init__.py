"""All epochs of a programme together: what each cell did over time, and how surely."""

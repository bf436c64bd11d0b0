"""Compiled mathematics on plain arrays: no input or output, no logging, no exceptions."""

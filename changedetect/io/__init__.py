"""Readers of survey sources and writers of products; the only layer that opens files of foreign formats."""

"""Recordings: played, stepped through a node, reported, and handed to other people's tools."""

"""Folders of results: how they are written whole or not at all, read again, and told in pages."""

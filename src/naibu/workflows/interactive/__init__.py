"""Models that are cut and touched: from files to pages and live simulation."""

"""Pages of tables and figures: what a chapter holds, its statements beside those of a source, and their HTML."""

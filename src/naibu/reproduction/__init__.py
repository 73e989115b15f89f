"""The report's tables and figures, one module a chapter, each beside ours."""

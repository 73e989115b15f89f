"""Bodies identified from displacement fields: kept in files, and predicted under other loads."""

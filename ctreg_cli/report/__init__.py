"""Pictures and pages from results: pure functions, nothing is opened or written here."""

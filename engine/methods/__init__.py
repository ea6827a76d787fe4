"""How a frame is matched: one file a method, each a function from a Query to a Fix or a NoFix."""

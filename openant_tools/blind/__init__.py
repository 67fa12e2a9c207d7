"""The blind benchmark: robots that nobody chose, simulated by other code than the analysis uses, with sealed answers."""

"""Which cause lost the communication: from recordings and run tables to causes with probability, evidence and remedy."""

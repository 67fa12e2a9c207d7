"""Reports that open offline: HTML with pictures."""

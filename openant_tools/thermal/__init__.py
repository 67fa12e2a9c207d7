"""Heat: soak runs, a two-node model of every servo, forecasts, derating, comparisons."""

"""Image processing, shape processing and flow visualisation on surfaces: one room for each."""

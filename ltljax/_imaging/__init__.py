"""Image processing, mesh processing and flow visualisation on surfaces, one room for each."""

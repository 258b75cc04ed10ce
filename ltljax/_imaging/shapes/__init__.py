"""The shape of the surface itself: fairing, denoising of scans, relief."""

"""Pictures: strobe, animation, curves, the page."""

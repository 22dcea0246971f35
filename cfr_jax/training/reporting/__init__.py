"""What a training tells of itself: metrics, charts, a page."""

"""The reports of a training: metrics, charts, and a page."""

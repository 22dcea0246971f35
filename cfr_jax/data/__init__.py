"""What goes in: corpora of shapes, protocols that make pairs of them, readers of real scans."""

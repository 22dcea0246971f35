"""PCD: clouds of PCL, in text, binary, and compressed binary."""

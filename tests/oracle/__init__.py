"""Float64 numpy reference answers, written from the published description and nothing of ours."""

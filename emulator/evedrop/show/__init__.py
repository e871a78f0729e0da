"""What a person looks at: the view, the page and pictures."""

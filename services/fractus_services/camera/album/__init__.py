"""Pictures on disk with the records by which they are judged again."""

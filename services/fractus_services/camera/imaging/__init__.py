"""Pictures as arrays: decoding, face detection, filters, metadata."""

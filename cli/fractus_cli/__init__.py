"""Commands of `fractus` that need no cluster: they read manifests and answer as the operator would."""

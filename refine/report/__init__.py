"""Pictures of a result, for people: the one-page sheet that is written beside the maps."""

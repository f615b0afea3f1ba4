"""Pictures drawn directly: markers, shells and plain solids as edges of exact pixel area."""

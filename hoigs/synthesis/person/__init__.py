"""The person: `choreography.Choreographer` poses it, `clothes.dress` dresses it."""

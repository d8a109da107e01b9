"""No more model than a scene needs: ladders of rungs, climbed on training frames held back."""

"""Speed of the instrument's parts, measured side by side with something plain in the same run."""

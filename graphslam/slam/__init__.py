"""From a log to a `Result`: `smooth.smooth` is the main job, for logs of all kinds."""

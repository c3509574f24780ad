"""The app: a page in the browser on which you drop a picture or a video to see its depth."""

"""The app: a page in the browser on which a picture or a video is dropped and its depth looked at."""

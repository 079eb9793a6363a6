"""Our controllers as predictors of pyRTC, and its predictors on recorded series."""

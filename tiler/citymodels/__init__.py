"""City models in the store and as CityJSON."""

"""A trace as integers, and facts about its steps that hold in every map."""

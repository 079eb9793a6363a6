"""The commands of a record: the law that computed them."""

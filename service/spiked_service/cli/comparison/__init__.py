"""Tables of methods x recordings x seeds x metrics: `rows` are methods, `cells` runs of one, `tables` and `page` show
them."""

// The tables of the page: CSV texts, read once. What is drawn, shown and saved comes from them.

const DATA = JSON.parse(document.getElementById("data").textContent);

// RFC 4180: cells in quotes may hold commas, line breaks and doubled quotes.
function cells(text) {
  const rows = [];
  let row = [], start = 0, at = 0;
  const plain = !text.includes('"');
  if (plain) {
    for (const line of text.split("\n")) if (line !== "") rows.push(line.split(","));
    return rows;
  }
  while (at < text.length) {
    let cell;
    if (text[at] === '"') {
      cell = "";
      for (;;) {
        const end = text.indexOf('"', at + 1);
        cell += text.slice(at + 1, end);
        at = end + 1;
        if (text[at] !== '"') break;
        cell += '"';
      }
    } else {
      start = at;
      while (at < text.length && text[at] !== "," && text[at] !== "\n") at += 1;
      cell = text.slice(start, at);
    }
    row.push(cell);
    if (text[at] !== ",") {
      rows.push(row);
      row = [];
    }
    at += 1;
  }
  return rows;
}

const NUMBERS = { "": NaN, inf: Infinity, "-inf": -Infinity, nan: NaN };

class Table {
  constructor(name) {
    this.name = name;
    this.text = DATA.tables[name];
    [this.head, ...this.rows] = cells(this.text);
    this.numbers = new Map();
    this.places = new Map(this.head.map((column, place) => [column, place]));
    this.found = new Map();
  }

  column(name) {
    const place = this.places.get(name);
    return this.rows.map((row) => row[place]);
  }

  values(name) {
    if (!this.numbers.has(name)) {
      this.numbers.set(name, this.column(name).map((text) => (text in NUMBERS ? NUMBERS[text] : Number(text))));
    }
    return this.numbers.get(name);
  }

  // Places of the rows with these texts in these columns.
  where(wanted) {
    const key = JSON.stringify(wanted);
    if (!this.found.has(key)) this.found.set(key, this.look(wanted));
    return [...this.found.get(key)];
  }

  look(wanted) {
    const tests = Object.entries(wanted).map(([name, text]) => [this.places.get(name), text]);
    const found = [];
    this.rows.forEach((row, place) => {
      if (tests.every(([column, text]) => row[column] === text)) found.push(place);
    });
    return found;
  }
}

const TABLES = new Map();

function table(name) {
  if (!TABLES.has(name)) TABLES.set(name, new Table(name));
  return TABLES.get(name);
}

// The API, drawn from openapi.json: works offline, and under a policy that allows scripts and styles of this host only.

const METHODS = ["get", "post", "patch", "put", "delete"];
const SHOWN_BYTES = 20000;

function make(tag, attributes = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
}

// The little Markdown that descriptions use: paragraphs, lists, fenced and inline code, bold.
function prose(text) {
    const parts = [];
    for (const [i, chunk] of text.split("```").entries()) {
        if (i % 2) {
            parts.push(make("pre", {}, chunk.trim()));
            continue;
        }
        for (const block of chunk.split(/\n\s*\n/)) {
            if (!block.trim()) continue;
            if (block.trim().startsWith("* ")) {
                const items = block.trim().slice(2).split(/\n\* /);
                parts.push(make("ul", {}, ...items.map((item) => make("li", {}, ...inline(item)))));
            } else {
                parts.push(make("p", {}, ...inline(block)));
            }
        }
    }
    return parts;
}

function inline(text) {
    return text.split(/(`[^`]+`|\*\*[^*]+\*\*)/).map((part) => {
        if (part.startsWith("`")) return make("code", {}, part.slice(1, -1));
        if (part.startsWith("**")) return make("strong", {}, part.slice(2, -2));
        return part;
    });
}

class Api {
    constructor(schema) {
        this.schema = schema;
    }

    resolve(node) {
        return node && node.$ref ? this.schema.components.schemas[node.$ref.split("/").pop()] : node;
    }

    // A schema in a few words.
    type(node) {
        if (!node) return "";
        if (node.$ref) {
            const target = this.resolve(node);
            return target.enum ? target.enum.join(" | ") : node.$ref.split("/").pop();
        }
        if (node.anyOf || node.oneOf) return (node.anyOf || node.oneOf).map((one) => this.type(one)).join(" | ");
        if (node.const !== undefined) return JSON.stringify(node.const);
        if (node.enum) return node.enum.join(" | ");
        if (node.prefixItems) return `[${node.prefixItems.map((one) => this.type(one)).join(", ")}]`;
        if (node.type === "array") return `${this.type(node.items)}[]`;
        if (node.format === "binary") return "bytes";
        const limits = [];
        if (node.minimum !== undefined) limits.push(`≥ ${node.minimum}`);
        if (node.exclusiveMinimum !== undefined) limits.push(`> ${node.exclusiveMinimum}`);
        if (node.maximum !== undefined) limits.push(`≤ ${node.maximum}`);
        const name = node.format && node.type === "string" ? node.format : node.type || "any";
        return limits.length ? `${name} ${limits.join(", ")}` : name;
    }

    // Whatever a request or answer could look like.
    example(node, depth = 0) {
        const target = this.resolve(node);
        if (!target || depth > 6) return null;
        if (target.examples?.length) return target.examples[0];
        if (target.default !== undefined) return target.default;
        if (target.enum) return target.enum[0];
        const options = target.anyOf || target.oneOf || target.allOf;
        if (options) return this.example(options[0], depth + 1);
        if (target.prefixItems) return target.prefixItems.map((one) => this.example(one, depth + 1));
        if (target.type === "array") return [this.example(target.items, depth + 1)];
        if (target.properties) {
            const fields = Object.entries(target.properties);
            return Object.fromEntries(fields.map(([name, field]) => [name, this.example(field, depth + 1)]));
        }
        return { string: "", integer: 0, number: 0, boolean: false, object: {} }[target.type] ?? null;
    }

    fields(node) {
        const target = this.resolve(node);
        if (!target?.properties) return make("p", { class: "faint" }, this.type(node));
        const required = new Set(target.required || []);
        const rows = Object.entries(target.properties).map(([name, field]) => {
            const text = field.description || this.resolve(field)?.description || "";
            const given = field.default !== undefined && field.default !== null ? ` (${JSON.stringify(field.default)})` : "";
            return make("tr", {},
                make("td", {}, make("code", {}, name), required.has(name) ? "" : make("span", { class: "faint" }, " ?")),
                make("td", { class: "faint" }, this.type(field) + given),
                make("td", {}, ...inline(text)));
        });
        return make("table", {}, heading("field", "type", "meaning"), ...rows);
    }
}

function heading(...names) {
    return make("tr", {}, ...names.map((name) => make("th", {}, name)));
}

function json(value) {
    return JSON.stringify(value, null, 2);
}

function curl(api, method, path, operation) {
    const words = ["curl"];
    if (method !== "get") words.push("-X", method.toUpperCase());
    const content = operation.requestBody?.content || {};
    const type = Object.keys(content)[0];
    if (type === "application/json") {
        words.push("-H", "'content-type: application/json'", "-d", `'${JSON.stringify(api.example(content[type].schema))}'`);
    } else if (type) {
        words.push("-H", `'content-type: ${type}'`, "--data-binary", "@CHUNK");
    }
    words.push(`'${location.origin}${path.replace(/\{(\w+)\}/g, (_, name) => name.toUpperCase())}'`);
    return words.join(" ");
}

// GETs can be tried: nothing changes by them.
function trial(path) {
    const input = make("input", { value: path, "aria-label": "Address" });
    const shown = make("div", {});
    const form = make("form", { class: "try" }, input, " ", make("button", {}, "Try"), shown);
    form.addEventListener("submit", async (event) => {
        event.preventDefault();
        shown.replaceChildren("…");
        try {
            const answer = await fetch(input.value);
            const type = answer.headers.get("content-type") || "";
            const blob = await answer.blob();
            let body;
            if (type.startsWith("image/") && !type.includes("exr")) {
                body = make("img", { src: URL.createObjectURL(blob), alt: "The picture" });
            } else if (/json|text/.test(type)) {
                const text = await blob.text();
                body = make("pre", {}, (type.includes("json") ? json(JSON.parse(text)) : text).slice(0, SHOWN_BYTES));
            } else {
                body = make("p", {}, `${blob.size} bytes of ${type || "nothing"}`);
            }
            shown.replaceChildren(make("p", { class: "faint" }, `${answer.status} ${type}`), body);
        } catch (error) {
            shown.replaceChildren(make("pre", {}, String(error)));
        }
    });
    return form;
}

function draw(api, method, path, operation) {
    const parts = [
        make("h3", {}, make("span", { class: `method ${method}` }, method), " ", make("span", { class: "path" }, path)),
        ...prose(operation.description || operation.summary || ""),
    ];
    if (operation.parameters?.length) {
        const rows = operation.parameters.map((one) => make("tr", {},
            make("td", {}, make("code", {}, one.name), one.required ? "" : make("span", { class: "faint" }, " ?")),
            make("td", { class: "faint" }, `${one.in}: ${api.type(one.schema)}`),
            make("td", {}, ...inline(one.description || ""))));
        parts.push(make("h4", {}, "Parameters"), make("table", {}, heading("name", "type", "meaning"), ...rows));
    }
    for (const [type, { schema }] of Object.entries(operation.requestBody?.content || {})) {
        parts.push(make("h4", {}, `Body, ${type}`), api.fields(schema));
        const examples = api.resolve(schema)?.examples || [];
        for (const one of examples) parts.push(make("pre", {}, json(one)));
    }
    parts.push(make("pre", {}, curl(api, method, path, operation)));
    if (method === "get") parts.push(trial(path));
    const answers = Object.entries(operation.responses).map(([status, answer]) => {
        const types = Object.keys(answer.content || {});
        const body = Object.entries(answer.content || {}).find(([type]) => type === "application/json");
        const more = body ? [make("details", {}, make("summary", {}, api.type(body[1].schema) || "JSON"),
            api.fields(body[1].schema), make("pre", {}, json(api.example(body[1].schema))))] : [];
        return make("tr", {}, make("td", {}, status), make("td", { class: "faint" }, types.join(", ")),
            make("td", {}, answer.description || "", ...more));
    });
    parts.push(make("details", {}, make("summary", {}, "Answers"), make("table", {}, ...answers)));
    return make("section", { class: "operation", id: operation.operationId }, ...parts);
}

function show(schema) {
    const api = new Api(schema);
    document.getElementById("version").textContent = schema.info.version;
    document.getElementById("about").replaceChildren(...prose(schema.info.description || ""));
    const groups = new Map((schema.tags || []).map((tag) => [tag.name, { text: tag.description, operations: [] }]));
    for (const [path, methods] of Object.entries(schema.paths)) {
        for (const method of METHODS.filter((name) => methods[name])) {
            const tag = methods[method].tags?.[0] || "other";
            if (!groups.has(tag)) groups.set(tag, { text: "", operations: [] });
            groups.get(tag).operations.push([method, path, methods[method]]);
        }
    }
    const toc = document.getElementById("toc");
    const main = document.getElementById("operations");
    for (const [tag, { text, operations }] of groups) {
        if (!operations.length) continue;
        toc.append(make("h2", {}, tag));
        main.append(make("h2", {}, tag), make("p", {}, text || ""));
        for (const [method, path, operation] of operations) {
            const link = make("a", { href: `#${operation.operationId}` },
                make("span", { class: `method ${method}` }, method), ` ${path.replace("/api/v1", "")}`);
            toc.append(link);
            main.append(draw(api, method, path, operation));
        }
    }
    document.getElementById("filter").addEventListener("input", (event) => {
        const wanted = event.target.value.toLowerCase();
        for (const link of toc.querySelectorAll("a")) link.hidden = !link.textContent.toLowerCase().includes(wanted);
    });
    if (location.hash) document.querySelector(location.hash)?.scrollIntoView();
}

try {
    const answer = await fetch("../openapi.json");
    show(await answer.json());
} catch (error) {
    document.getElementById("about").textContent = `The description of the API could not be loaded: ${error}`;
}

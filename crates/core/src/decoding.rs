//! What serde says about a value, in the terms of the file that the value stands in.

/// Rewrites a message of serde, which names types of Rust. `table` is what the format calls keys with values: a table in
/// TOML, an object in JSON.
pub fn decoding_message(message: &str, table: &str) -> String {
    let Some((what, expected)) = message.rsplit_once(", expected ") else {
        let what =
            message.replacen("missing field", "missing key", 1).replacen("unknown field", "unknown key", 1);
        return what.replacen("there are no fields", "no further keys are allowed", 1);
    };
    if let Some(found) = what.strip_prefix("invalid type: ").or(what.strip_prefix("invalid value: ")) {
        return format!("expected {}, found {}", kind(expected, table), value(found, table));
    }
    if let Some(length) = what.strip_prefix("invalid length ") {
        return format!("expected {}, found {length}", kind(expected, table));
    }
    let what =
        what.replacen("unknown variant", "unknown value", 1).replacen("unknown field", "unknown key", 1);
    format!("{what}, expected {expected}")
}

/// Like [`decoding_message`], for a table that also has the key `beside`, which was read before.
pub fn decoding_message_beside(message: &str, table: &str, beside: &str) -> String {
    let text = decoding_message(message, table);
    if !text.starts_with("unknown key") {
        return text;
    }
    let Some((what, expected)) = text.split_once(", expected ") else {
        return text.replace("no further keys are allowed", &format!("expected `{beside}`"));
    };
    let known = expected.strip_prefix("one of ").unwrap_or(expected).replace(" or ", ", ");
    if known.contains(", ") {
        format!("{what}, expected one of {known}, `{beside}`")
    } else {
        format!("{what}, expected {known} or `{beside}`")
    }
}

/// What serde expected, by its name in Rust.
fn kind(expected: &str, table: &str) -> String {
    let (first, rest) = expected.split_once(' ').unwrap_or((expected, ""));
    match (first, rest) {
        ("f32" | "f64", "") => "a number".into(),
        ("u8", "") => format!("a whole number from 0 to {}", u8::MAX),
        ("u16", "") => format!("a whole number from 0 to {}", u16::MAX),
        ("u32", "") => format!("a whole number from 0 to {}", u32::MAX),
        ("u64" | "usize", "") => "a whole number, 0 or more".into(),
        ("i8" | "i16" | "i32" | "i64" | "isize", "") => "a whole number".into(),
        ("a", "boolean") => "true or false".into(),
        ("a", "sequence") => "a list".into(),
        ("an", array) if array.starts_with("array of length ") => {
            format!("a list of {} values", &array["array of length ".len()..])
        }
        ("a", tuple) if tuple.starts_with("tuple of size ") => {
            format!("a list of {} values", &tuple["tuple of size ".len()..])
        }
        ("path", "string") => "a path, which is a string".into(),
        ("struct" | "internally", _) | ("a" | "", "map") => format!("{} {table}", article(table)),
        ("enum" | "variant", _) => "a string".into(),
        _ => expected.into(),
    }
}

/// What serde found.
fn value(found: &str, table: &str) -> String {
    let inside = |prefix: &str| found.strip_prefix(prefix)?.strip_suffix('`');
    if let Some(number) = inside("integer `").or_else(|| inside("floating point `")) {
        return format!("the number {number}");
    }
    if let Some(flag) = inside("boolean `") {
        return flag.into();
    }
    match found {
        "sequence" => "a list".into(),
        "map" => format!("{} {table}", article(table)),
        "unit value" => "null".into(),
        _ if found.starts_with("string ") => format!("the {found}"),
        _ => found.into(),
    }
}

fn article(noun: &str) -> &'static str {
    if noun.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" }
}

#[cfg(test)]
mod tests {
    use super::decoding_message;

    #[test]
    fn a_key_that_was_read_before_is_expected_too() {
        for (serde, ours) in [
            ("unknown field `a`, there are no fields", "unknown key `a`, expected `name`"),
            ("unknown field `a`, expected `b`", "unknown key `a`, expected `b` or `name`"),
            ("unknown field `a`, expected `b` or `c`", "unknown key `a`, expected one of `b`, `c`, `name`"),
            (
                "unknown field `a`, expected one of `b`, `c`, `d`",
                "unknown key `a`, expected one of `b`, `c`, `d`, `name`",
            ),
            ("missing field `a`", "missing key `a`"),
        ] {
            assert_eq!(super::decoding_message_beside(serde, "table", "name"), ours);
        }
    }

    #[test]
    fn types_of_rust_become_those_of_the_file() {
        for (serde, ours) in [
            ("invalid type: string \"1\", expected f64", "expected a number, found the string \"1\""),
            (
                "invalid type: integer `3`, expected struct VsyncSection",
                "expected a table, found the number 3",
            ),
            (
                "invalid value: integer `-1`, expected u64",
                "expected a whole number, 0 or more, found the number -1",
            ),
            ("invalid length 1, expected an array of length 2", "expected a list of 2 values, found 1"),
            ("invalid type: map, expected a sequence", "expected a list, found a table"),
            ("invalid type: integer `1`, expected a boolean", "expected true or false, found the number 1"),
            ("unknown variant `a`, expected `b` or `c`", "unknown value `a`, expected `b` or `c`"),
            ("unknown field `a`, there are no fields", "unknown key `a`, no further keys are allowed"),
            ("missing field `name`", "missing key `name`"),
        ] {
            assert_eq!(decoding_message(serde, "table"), ours);
        }
        assert_eq!(
            decoding_message("invalid type: null, expected struct Plan", "object"),
            "expected an object, found null"
        );
    }
}

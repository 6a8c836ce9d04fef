//! What differs from run to run, and is not what is tested: ages, times, ids, measured amounts, widths of columns.

/// The text with what differs replaced.
pub(crate) fn redact(text: &str, dir: &str) -> String {
    let text = text.replace(dir, "<dir>");
    let mut lines: Vec<String> = text.lines().map(line).collect();
    while lines.last().is_some_and(String::is_empty) {
        lines.pop();
    }
    lines.join("\n")
}

fn line(line: &str) -> String {
    // Columns are as wide as their widest cell, which may be an age.
    let indent = line.len() - line.trim_start().len();
    let words: Vec<String> = line.split_whitespace().map(word).collect();
    format!("{}{}", &line[..indent], words.join(" "))
}

fn word(word: &str) -> String {
    let inner = word.trim_matches(|c: char| "\"',():".contains(c));
    let kept = match inner {
        _ if is_age(inner) => "<age>",
        _ if is_uid(inner) => "<uid>",
        _ if is_time(inner) => "<time>",
        _ => return word.to_owned(),
    };
    word.replacen(inner, kept, 1)
}

fn is_age(word: &str) -> bool {
    let (mut digits, mut units) = (0, 0);
    for c in word.chars() {
        match c {
            '0'..='9' if units == 0 || digits > 0 => digits += 1,
            '0'..='9' => digits = 1,
            's' | 'm' | 'h' if digits > 0 => {
                units += 1;
                digits = 0;
            }
            _ => return false,
        }
    }
    // `100m` of cpu is no age; `2m` is.
    units > 0 && digits == 0 && (!word.ends_with('m') || word.len() <= 2)
}

fn is_uid(word: &str) -> bool {
    word.len() == 36
        && word.split('-').map(str::len).eq([8, 4, 4, 4, 12])
        && word.chars().all(|c| c == '-' || c.is_ascii_hexdigit())
}

fn is_time(word: &str) -> bool {
    word.parse::<jiff::Timestamp>().is_ok()
}

#[test]
fn only_what_differs_is_replaced() {
    let text = "NAME   READY   AGE\nhello   1/1     12s\ncpu: 100m at 2026-01-01T00:00:00Z: 3m2s";
    assert_eq!(redact(text, "/tmp"), "NAME READY AGE\nhello 1/1 <age>\ncpu: 100m at <time>: <age>");
}

/** A table that scrolls sideways on narrow screens, also by keyboard. */

import type { JSX, ReactNode } from "react";

export interface Column {
  name: string;
  /** Numbers are aligned to the right. */
  number?: boolean;
  /** The name is for screen readers only. */
  hidden?: boolean;
  /** The head is a button that sorts by the column. */
  sorting?: { direction: "ascending" | "descending" | "none"; onSort: () => void } | undefined;
}

const ARROWS = { ascending: " ↑", descending: " ↓", none: "" };

export function Table({
  label,
  className,
  columns,
  children,
  below,
}: {
  label: string;
  className: string;
  columns: readonly Column[];
  /** The rows. */
  children: ReactNode;
  below?: ReactNode;
}): JSX.Element {
  return (
    <div className="scroll" role="region" aria-label={label} tabIndex={0}>
      <table className={className}>
        <thead>
          <tr>
            {columns.map((column) => (
              <th
                key={column.name}
                scope="col"
                className={column.number === true ? "number" : undefined}
                aria-sort={column.sorting?.direction}
              >
                {column.hidden === true ? (
                  <span className="hidden">{column.name}</span>
                ) : column.sorting === undefined ? (
                  column.name
                ) : (
                  <button type="button" className="bare sorts" onClick={column.sorting.onSort}>
                    {column.name}
                    <span aria-hidden="true">{ARROWS[column.sorting.direction]}</span>
                  </button>
                )}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>{children}</tbody>
      </table>
      {below}
    </div>
  );
}
